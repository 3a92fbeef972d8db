"""Recording: MCAP bags in rosbag2's layout, their reader and their repair; nothing needs ROS."""
