"""The commands of ``scripts/``, one module a command; each ``main()`` returns the exit code."""
