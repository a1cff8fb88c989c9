"""From a model to machine code: equations merges effects in, derivatives and codegen make slopes and sensitivities of
them, column_code and machine_code assemble these, fingerprint says when that was done before; loops pass over data,
between whose samples curves read inputs, and kernel is what all others call."""
