"""Which nonlinearity causes a limit cycle: by ablation of the model, by the shape of a record."""
