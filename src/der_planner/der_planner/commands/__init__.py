"""The commands of ``scripts/``; each ``main()`` returns the exit code.

One module is one command; that of ``recover_bag.py`` stands in `der_planner.bags.recover`.
"""
