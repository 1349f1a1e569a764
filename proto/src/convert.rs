//! The only place where bytes from the wire become records.
