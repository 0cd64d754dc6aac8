"""One control step of many rallies: state, flight and touches, perception, observation, reward."""
