"""The response of a camera to the bins of object planes, and the inversion of the response.

`cells` divides bins and detector into parts that repeat from lens to lens, `wave_spreads` and `ray_spreads` compute the
light on the detector from the bins of one part, `kernels` keeps the parts that are not dark, `plane` and `response`
apply them to the whole, and `solver` inverts the response as far as `noise` allows.
"""
