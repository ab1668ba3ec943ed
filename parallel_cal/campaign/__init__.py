"""Let a robot calibrate itself: plan poses, move, measure, judge, and decide when to stop."""
