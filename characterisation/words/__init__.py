"""Share numbers, tables and messages for readers, and the version, between both packages."""
