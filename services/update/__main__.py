"""`python -m services.update`: the words of `diffuscope update` without the rest of the program.

What judges a new version must not need what it judges: no numerics, no drivers, no server. The units call this.
"""

from services.update.command import main

main()
