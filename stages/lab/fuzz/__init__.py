"""Small files of every format, damaged at random, and what their readers make of them."""
