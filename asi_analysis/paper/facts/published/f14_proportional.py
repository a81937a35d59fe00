"""F14: Table 1, the column of the proportional controller at Kp = 3."""

from asi_analysis.paper.facts.table_1 import column

FACT = column('F14', 'proportional', 'P, Kp = 3', 0.04, (20.0, 16.0, 24.0), 0.18,
              (6.0, 4.8, 7.2))
