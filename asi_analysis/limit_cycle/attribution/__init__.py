"""Which nonlinearity causes a limit cycle: by ablation of the model, or by shape of a record."""
