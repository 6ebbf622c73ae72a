"""Find where a recording and its simulation differ, and which physics is missing.

`core.diagnose` runs the steps, one package each; docs/diagnosis-method.md explains them.

1. ``reduce``: read the log once, into statistics of blocks.
2. ``baseline``: the noise, and the effects of the simulation, to compare with.
3. ``nulls``: null records of that noise, and the thresholds that they give.
4. ``identify``: select the effects that predict held-out data better, by their ``evidence``.
5. ``locate``: find the mismatches, each with its axes, time and averaging times.
6. ``estimate``: fit all effects and the noise together.
7. ``result``: verdict, explained mismatches, held-out evidence, model and report text.

``statistics`` has one file for each way to look at a recording, and ``predict`` what the effects do
to each of them.
"""
