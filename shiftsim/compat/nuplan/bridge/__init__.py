"""Between shiftsim's arrays and nuPlan's objects, written against the `nuplan.*` names.

They are the devkit's where it is installed and the shims otherwise, so that this code is the
same for both. Importing this package sees to it that the names exist.
"""

from shiftsim.compat.nuplan import install

install()
