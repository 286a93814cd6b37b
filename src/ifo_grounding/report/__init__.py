"""Showing what was learned: tables, plots, animations, case studies, and one page with all."""

from ifo_grounding.report.animation import animation
from ifo_grounding.report.casestudy import instruction_cases
from ifo_grounding.report.drawing import Captioned, gallery
from ifo_grounding.report.page import write_report
from ifo_grounding.report.plots import rates_by_number, reliability_diagram, training_curves
from ifo_grounding.report.provenance import provenance
from ifo_grounding.report.results import results_rows
from ifo_grounding.report.tables import markdown_table, text_table
from ifo_grounding.report.theme import figure_png
from ifo_grounding.report.tracing import trace_animation

__all__ = [
    "Captioned",
    "animation",
    "figure_png",
    "gallery",
    "instruction_cases",
    "markdown_table",
    "provenance",
    "rates_by_number",
    "reliability_diagram",
    "results_rows",
    "text_table",
    "trace_animation",
    "training_curves",
    "write_report",
]
