"""Figures and films of finished runs. The only part of the toolkit that imports matplotlib.

Every function takes logs and curves as they are and returns a matplotlib `Figure`; `style.save_figure` writes it.

    style               colours, sizes, axes, atomic files
    space               three-dimensional space on flat axes
    backbone_drawing    arms, sensors, targets; the stroboscopic comparison of controllers
    kinematic           section V-A: the four-way panel, the estimates, the sensors' residuals
    dynamic             section V-B and appendix A: controllers compared over a grid of runs
    replay              a replayed recording and what the gate held back
    animation           the film of a run
    hero                the picture at the head of the README
"""
