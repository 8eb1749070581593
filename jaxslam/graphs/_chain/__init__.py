"""The graph of a path and a map, solved along the path.

The factors are those of `graphs.of_log`: a motion between successive poses, measurements of
landmarks, a prior of the first pose. What differs is the solution. A motion is not a residual with
an information but a constraint with its noise as unknown, so that Q and the prior may be singular;
and the poses are eliminated one after the other, so that no plan has to know on the host which
landmark is measured where: in a campaign the association of the run says it.
`jaxslam.graphs.smoothing` makes estimators of it; `graphs.optimize` solves graphs of any pattern.
"""
