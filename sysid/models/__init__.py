"""Model document → `Model`: parameters, equations, initial states, polynomial models, catalogue."""
