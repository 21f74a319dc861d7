"""What `deltas depth` found, to look at: coloured maps, a contact sheet, a page of its own."""
