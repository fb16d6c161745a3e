void put_text(const char *text);
void leave(int status);
