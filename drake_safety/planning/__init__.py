"""Goals and plans judged before anything moves, and chosen by what the judgement says."""
