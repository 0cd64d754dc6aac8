"""The static page of an exported policy: a folder that any file server serves, and that plays in the browser alone."""
