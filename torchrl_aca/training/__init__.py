"""Algorithm-free helpers of the recipes: environments, data, evaluation, run directory, resume."""
