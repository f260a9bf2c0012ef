"""Configurations: what can be set (`schema`) and how settings become objects (`build`). No hydra in here."""
