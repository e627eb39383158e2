"""Command lines only: parse, make one Options, call one run()."""
