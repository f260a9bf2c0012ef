"""The paper's tables, figures and studies, beside its printed numbers."""
