"""Wave captures of explicit points as a linear operator: forward sums, the adjoint, and derivatives."""
