"""Closed-loop evaluation and the tables of the paper, on the follower of the runtime itself."""
