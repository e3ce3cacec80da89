"""Five tests that a causal forecaster should pass, as numbers."""
