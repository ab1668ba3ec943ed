"""From messages to samples: streams, cleaning, standstill, pairing, replicates."""
