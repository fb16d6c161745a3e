"""The paper's tables: costs, iterations, properties, tableaux."""
