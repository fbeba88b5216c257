"""Wave captures of explicit points as a linear operator: its sums, its adjoint and its derivatives."""
