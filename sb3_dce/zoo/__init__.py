"""The only part of the package that knows rl_zoo3: ``python -m sb3_dce.zoo train --algo dce --env <dataset id>``."""
