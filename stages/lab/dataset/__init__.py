"""The GSCollision data set: making, checking, importing."""
