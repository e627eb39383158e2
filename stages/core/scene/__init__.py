"""The data model, and the only code that knows a file format."""
