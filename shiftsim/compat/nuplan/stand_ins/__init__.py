"""Stand-ins for classes of nuPlan's devkit: same names, attributes and meaning, own code.

`shiftsim.compat.nuplan.finder` puts them under the `nuplan.*` module names. What differs from the
devkit on purpose: the rear axle of a footprint made from one is that one to the last bit.
"""
