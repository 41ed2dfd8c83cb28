"""Kernels compiled with Numba, gradients by hand-written adjoints; the arm, friction and answers likewise.

`lip` and `chain` state the two energy kernels: `joints` and `products` are what both are made of, `lip_kinetic`, and
`chain_sums` and `chain_kinetic` in the algebra of `jets`, what is their own. Each function stands beside its adjoint.
`pairs` goes over the pairs of samples; `kernel` is the class that joins it all to PyTorch. All calculate with `lanes`
in memory laid out by `views`.
"""
