"""Six checks that a causal forecaster should pass, as numbers."""
