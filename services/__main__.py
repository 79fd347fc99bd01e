"""`python -m diffuscope`: the command line, as the wheel installs this module as `diffuscope/__main__.py`."""

from services.cli import main

if __name__ == "__main__":
    main()
