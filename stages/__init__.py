"""Photos to 4D: the library behind the six commands, one folder per stage."""

# command -> (files in, files out), in the order of the pipeline
PIPELINE = {
    "reconstruct": (("photos/",), ("scene.ply",)),
    "segment": (("scene.ply",), ("labelled.ply",)),
    "refine": (("labelled.ply",), ("refined.ply",)),
    "simulate": (("refined.ply",), ("traj.h5",)),
    "render": (("traj.h5",), ("video.mp4",)),
    "evaluate": (("traj.h5", "truth.h5"), ("metrics.json",)),
}
