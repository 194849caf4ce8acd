// What each pixel asks of the pass `trace`, and what it got (method dpm): see `DEMAND_NOT_LIT`.
//
// Two blocks of one buffer: synchronisation validation does not miss a barrier before a block that is both read and written.
layout(set = 0, binding = B_GUIDES, scalar) readonly buffer DemandsBefore { uint demands_before[]; };
layout(set = 0, binding = B_GUIDES, scalar) writeonly buffer Demands { uint demands[]; };

// To be asked before `set_demand`.
uint demand_at(uint at) { return demands_before[GUIDES_DEMAND_AT(at)]; }

void set_demand(uint at, uint demand) { demands[GUIDES_DEMAND_AT(at)] = demand; }
