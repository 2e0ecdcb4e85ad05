"""`sightline frame`: the commands of frames."""
