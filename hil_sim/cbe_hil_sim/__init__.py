"""Simulated worlds, cameras, scanners and vehicles: the robot's stand-in for training and tests."""
