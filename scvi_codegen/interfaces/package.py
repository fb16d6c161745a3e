"""Import path of the package loader used by integrators generated with version 0.1."""

from scvi_codegen.interfaces.models.packages.package import load_package as load_package
