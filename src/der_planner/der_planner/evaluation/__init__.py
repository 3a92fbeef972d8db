"""From bags to errors, tables and figures."""
