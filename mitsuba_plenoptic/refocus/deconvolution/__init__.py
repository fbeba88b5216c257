"""The response of a camera to the bins of object planes, and its inversion.

`cells` cuts bins and detector into parts that repeat from lens to lens, `wave_spreads` and `ray_spreads` compute how
the bins of one of them light the detector, `kernels` keeps what of that is not dark, `plane` and `response` apply it to
all, and `solver` inverts it, as far as `noise` allows.
"""
