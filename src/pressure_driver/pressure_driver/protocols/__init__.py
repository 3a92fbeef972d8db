"""The languages of valve boards."""
