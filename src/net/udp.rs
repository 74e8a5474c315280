//! Batched UDP on real sockets.
