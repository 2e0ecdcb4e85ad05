"""`sightline robot`: the commands of a robot."""
