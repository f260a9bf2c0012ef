"""Runs in the messages of other tools: Foxglove's, in a file and live, and bags of ROS 2."""
