"""Walking: the task that policies are trained on, batched."""
