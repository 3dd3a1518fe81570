"""``python -m sb3_dce`` is ``sb3-dce``."""

from sb3_dce.cli import main

if __name__ == "__main__":
    main()
