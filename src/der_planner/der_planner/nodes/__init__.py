"""The ROS nodes: thin, parameters, topics and calls."""
