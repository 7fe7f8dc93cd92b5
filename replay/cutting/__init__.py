"""Parts of logs as logs of their own: messages are copied as they are, and never decoded."""
