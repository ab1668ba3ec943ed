"""Solvers of kinematics that the documents compare: the shelf kinematics.solvers goes on here."""
