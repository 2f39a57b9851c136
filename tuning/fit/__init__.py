"""Any differentiable loss by gradient, over batches of runs: parameters, objectives, optimizers, checkpoints."""
