"""Instance segmentation of reconstructed scenes by a sparse 3D network and agglomerative clustering."""
