"""Components shared by experiments: results, drawings, plain implementations to compare with."""
