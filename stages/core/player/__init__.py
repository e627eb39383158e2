"""The player: a page that draws a scene or a trajectory with WebGL2, in one file and without a server."""
