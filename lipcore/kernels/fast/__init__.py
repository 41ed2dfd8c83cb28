"""Kernels compiled with Numba, with gradients by hand-written adjoints; also the arm, friction and predictions.

`lip` and `chain` are the two energy kernels. Both use `joints` and `products`. `lip` also uses `lip_kinetic`; `chain`
uses `chain_sums` and `chain_kinetic`, in the algebra of `jets`. Each function stands beside its adjoint. `pairs` loops
over the pairs of samples. `kernel` is the class that connects the compiled functions to the fit. All compute with
`lanes`, in memory laid out by `views`.
"""
