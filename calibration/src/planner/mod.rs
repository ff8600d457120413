//! What a rig will do, from its data sheets, before anything is bolted down.
