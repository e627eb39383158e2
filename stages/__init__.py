"""Photos to 4D: the library behind the six commands, one folder per stage."""

import os

# Threads that wait for each other sleep instead of spinning: with other work on the machine a spinning thread takes the
# core from the one it waits for. NumPy's products are small here and called from several threads: one thread each.
# OpenMP and OpenBLAS read these when PyTorch and NumPy are first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 27))  # a file of 200 kB can declare 2^30 pixels
