"""Generation, verification and import of the GSCollision data set."""
