"""Figures and films of finished runs, and `python -m apcc_torch.report`. The only part that imports matplotlib.

Every function that draws takes logs and curves as they are and returns a matplotlib `Figure`; `style.save_figure`
writes it.

    style               colours, sizes, axes, atomic files
    space               three-dimensional space on flat axes
    backbone_drawing    arms, sensors, targets; the stroboscopic comparison of controllers
    kinematic           section V-A: the four-way panel, the estimates, the sensors' residuals
    dynamic             section V-B and appendix A: controllers compared over a grid of runs
    replay              a replayed recording and what the gate held back
    state_feedback      experiment I on an arm: four estimators of one motion
    overlay             experiment II on an arm: arm and model in a plane, the way to the set-point
    animation           the film of a run
    arm_scene           an environment's arm, as a picture or in a window
    hero                the picture at the head of the README

Reports on sets of runs:

    collect             finds the runs below any folders, complete or not
    run_record          one run, and the files its folder describes itself with
    batch_points        the points of a batch
    settings            flat settings, and which of them were swept
    units               names and units of columns
    run_table           the tidy table, as CSV and Parquet
    ranking             the order of runs, and the terminal's summary
    pictures            figures and films as they go into a page
    page                the HTML page: one file, without network
    __main__            the program
"""
