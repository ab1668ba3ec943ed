"""Algorithms of forward and inverse kinematics."""
