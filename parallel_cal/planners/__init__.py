"""What planned poses are chosen from, and what they are judged by."""
