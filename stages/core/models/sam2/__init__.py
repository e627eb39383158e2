"""SAM 2.1: masks of a photo from points, boxes or automatically, and their propagation through a sequence of photos.

The network is that of the package transformers; this package loads its weights, prepares its input, and bounds its
memory. `segmenter.Sam2Segmenter` is the interface that `ngff segment` uses.

Source: Ravi et al. 2024, "SAM 2: Segment Anything in Images and Videos".
"""
