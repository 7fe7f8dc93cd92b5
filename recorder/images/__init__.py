"""Images in messages and files of others: decoded, made gray and small."""
