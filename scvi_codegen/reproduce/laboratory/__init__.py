"""What every experiment is made with: results, drawings, plain implementations to compare with."""
