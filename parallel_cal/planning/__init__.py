"""Select the poses to measure, and predict what they determine."""
