"""The plan: what a call compiles and estimates, and why."""
