"""A simulation that answers to the user in a browser while it runs."""
