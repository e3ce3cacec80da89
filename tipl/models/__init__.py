"""Forecasters, one folder for each: the network, its data, its training, and the forecaster."""
