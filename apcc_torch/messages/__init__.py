"""Runs in the messages of other tools: Foxglove's, in a file and live, and bags of ROS 2.

frames           names of frames, and poses in them
topic            topics with their schemas, and where messages go: a file, a server
run_layout       the numbers of an instant
foxglove_library Foxglove's library, where it is installed
foxglove_scene   instants as messages of Foxglove's own schemas
foxglove_stream  the topics of a run
foxglove_file    finished runs as MCAP files
live_stream      a run on an arm, live
log_bag          the log of a run as a bag of ROS 2
"""
