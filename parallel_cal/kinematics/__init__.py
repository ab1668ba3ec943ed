"""The direct and inverse problem: solvers, solutions, singularities."""
