"""SAM 2.1: masks in a photo from clicks, boxes or nothing at all, and their propagation over a sequence.

The network is that of the package transformers; what is here finds its weights, feeds it, and bounds its memory.

Source: Ravi et al. 2024, "SAM 2: Segment Anything in Images and Videos".
"""
