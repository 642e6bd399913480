"""How the tables came to be, one dated step a file. Run them with ``camind migrate``."""
