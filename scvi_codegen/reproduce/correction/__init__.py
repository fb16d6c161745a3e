"""The chain-rule term that the printed SCVI lacks: derived, measured, drawn."""
