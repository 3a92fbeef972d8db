"""The commands of ``scripts/ros2``, the stand-in for machines without ros2cli: one module each."""
