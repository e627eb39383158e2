"""The data model and its file formats, described in README.md."""
