"""The reference pages and pictures of the documentation, made from the literal tables of the code."""
