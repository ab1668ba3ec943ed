"""Where a model fails, which effect it lacks, and what to measure next."""
