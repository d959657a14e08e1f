"""What runs on the robot: networks, route memory, follower, loop, teaching and recording."""
