"""Models as data: documents, the catalogue, polynomial expansion."""
