"""
The paper's tables and figures by one command, ``sb3-dce reproduce <id>``.

``grids/*.yml`` say what is trained, :mod:`~sb3_dce.experiments.grid` expands them to runs, :mod:`~sb3_dce.experiments.run`
carries them out, :mod:`~sb3_dce.experiments.results` turns run folders into rows. Tables, figures, verdicts and pages are
made from rows alone.
"""
