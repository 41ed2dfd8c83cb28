"""Kernels compiled with Numba: Gram matrices pair by pair, gradients by hand-written reverse mode.

`compile` wraps Numba, `kernel` is the base class of kernels that use compiled code. `chain` and `lip` are the two
kernels; the modules named after them hold their parts, each function beside the one that goes backward through it.
"""
