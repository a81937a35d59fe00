"""F16: Table 1, the column of the fourth-order lead."""

from asi_analysis.paper.facts.table_1 import column

FACT = column('F16', 'lead4', 'fourth-order lead', 0.007, (0.0, 0.0, 2.0), 0.04, (0.0, 0.0, 0.5))
