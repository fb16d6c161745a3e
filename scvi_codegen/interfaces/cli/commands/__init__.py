"""Commands of ``scvi-codegen``, one module each: options, and the report that is printed."""
