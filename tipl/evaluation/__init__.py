"""Evaluates forecasters on runs that they were not trained on."""
