"""The site of docs/: what is generated for it, and how it is built."""
