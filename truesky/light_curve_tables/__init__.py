"""Light curves of the sources of a lake in the planned exposures of a request."""
