"""Tables, sessions, migrations, content-addressed objects."""
