"""How a missing effect is looked for: columns, scores, guards, the search, what to measure next."""
