"""Arms in the browser: a simulated one that follows a target, a finished run, a live one.

moment         one instant of an arm, as numbers
outline        moments of a kinematic model
tube           a mesh around a curve
scene          what stands in space, on a page
panel          what is told beside it
page           the page itself, with viser
pursuit        an arm under its controller, in steps
follower       that arm in real time, after a target that can be dragged
recorded       a finished run's moments
player         them, under a time slider
recent_errors  the error of the last seconds
live_page      the page of a run on an arm, in a process of its own
live_process   the process that shows it, and the memory that it shares with the run
live_view      what the run hands to it
env_window     an environment's pictures
"""
