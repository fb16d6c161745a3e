"""What callers give: kinds of arguments, whole numbers and keywords, refused by name before anything is done."""
