"""Pictures of motions: where they go, what they conserve, and how they move. The room that knows matplotlib."""
