"""Robot logs: rosbag1, rosbag2 (sqlite3 and MCAP) and MCAP files, read without ROS."""
