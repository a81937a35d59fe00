"""F15: Table 1, the column of the lead-lag controller."""

from asi_analysis.paper.facts.table_1 import column

FACT = column('F15', 'lead_lag', 'lead-lag', 0.01, (14.0, 11.2, 16.8), 0.08, (2.0, 0.0, 2.0))
