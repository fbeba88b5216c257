"""Bad inputs for the package: strategies that write them, a process that evaluates them, and the verdict on each.

A case is the text of one Python expression, in the names of `workbench`: it can be sent to another process, shrunk by
Hypothesis, printed in a report and evaluated again as it stands. What the documentation forbids is written
``forbidden(...)`` and must be refused; anything else must be refused or give a whole result.
"""
