"""The core that both environments run on: state, draws, light and scores of episodes."""
