-- The work on one datagram, and the headers of the links.

local W = {serial = 0, layer = {}, at = {}, inside = {}, found = {}, is_found = {}}
local peers, sequences = {}, {}  -- what is known of senders, see init()
local read, L = D.read, D.layouts
local identities = {}
for _, pair in ipairs(D.identities) do
	identities[pair[2]] = identities[pair[2]] or {}
	identities[pair[2]][pair[1]] = true
end

-- `key` is of these bytes alone; `listed` tells whether anybody sees the columns, `cut_off` whether bytes are missing.
local function begin(s, link, pinfo, key, listed, cut_off)
	W.serial = W.serial + 1
	W.s, W.link, W.pinfo, W.key, W.listed, W.cut = s, link, pinfo, key, listed, cut_off
	W.layers, W.findings, W.entries, W.spacecraft, W.processor, W.bare = 0, 0, 0, 0, 0, false
	W.stop, W.kind, W.msg_id, W.code, W.time, W.summary = nil, nil, nil, nil, nil, nil
	W.route, W.message, W.envelope, W.padding, W.known, W.crc_at = nil, nil, nil, nil, nil, nil
	W.pdu, W.packets, W.entries_read, W.text = nil, nil, nil, nil
end

-- Note a finding, once; they stay in the order of their bits.
local function note(label)
	local index = FINDING[label]
	if W.is_found[index] == W.serial then return end
	W.is_found[index] = W.serial
	local found, place = W.found, W.findings + 1
	W.findings = place
	while place > 1 and found[place - 1] > index do
		found[place] = found[place - 1]
		place = place - 1
	end
	found[place] = index
end

local function has(label)
	return W.is_found[FINDING[label]] == W.serial
end

-- Add a header that starts at an offset; `inside` shows what is told below it.
local function add_layer(layout, at, inside)
	local work = W
	local count = work.layers + 1
	work.layers, work.layer[count], work.at[count], work.inside[count] = count, layout, at, inside
end

-- Note that a header is cut. Offsets count from the datagram's first byte, from 0.
local function truncated(name, at, need)
	note("truncated")
	W.stop = format("%s at byte %d needs %d bytes, %d are there", name, at, need, math.max(0, #W.s - at))
end

-- Take a header that must be whole; tell whether it is.
local function take(layout, at)
	if #W.s - at < layout.size then
		truncated(layout.name, at, layout.size)
		return false
	end
	add_layer(layout, at)
	return true
end

-- Tell the older 7-byte header: its size fits, and so does what then follows it.
local function is_legacy(s)
	local at = L.sbn_legacy.size
	if #s < at then return false end
	local size, kind = read.sbn_legacy(s, 1)
	if size ~= #s - at or not D.sbn.names[kind] then
		return false
	elseif kind == D.sbn.APP then
		return size >= L.ccsds.size and select(7, read.ccsds(s, at + 1)) + D.limits.length_bias == size
	elseif kind == D.sbn.PROTO then
		return size == L.sbn_proto.size
	elseif kind == D.sbn.SUB or kind == D.sbn.UNSUB then
		return s:sub(at + 1, at + 1) == "$"
	end
	return size == 0
end

local source, source_text  -- the last address: most datagrams come from where the one before did

-- Return the table that another has under a key.
local function nested(outer, key)
	local inner = outer[key]
	if not inner then
		inner = {}
		outer[key] = inner
	end
	return inner
end

-- Return what is known of the endpoint that a datagram came from: a table in `places`, by address and port.
local function sender(places)
	local address, port = W.pinfo.src, W.pinfo.src_port
	if address ~= source then source, source_text = address, tostring(address) end
	return nested(places, source_text), port
end

-- Return what is known of the endpoint that a datagram goes to.
local function receiver(places)
	return nested(places, tostring(W.pinfo.dst)), W.pinfo.dst_port
end

-- Compare a sender with the one its endpoint is known by: the first identity that it gave.
local function identify(spacecraft, processor, trusted)
	local place, port = sender(peers)
	local known = place[port]
	if trusted and not known then
		known = {spacecraft = spacecraft, processor = processor, since = W.pinfo.number}
		place[port] = known
	end
	if known and known.since < W.pinfo.number
		and (known.spacecraft ~= spacecraft or known.processor ~= processor)
		and not (identities[processor] and identities[processor][spacecraft]) then
		note("sbn_id_mismatch")
	end
end

local IDENT = D.sbn.ident .. string.rep("\0", D.sbn.ident_bytes - #D.sbn.ident)

local function subscriptions(at)
	if not take(L.sbn_sub, at) then return end
	local s = W.s
	local count = read.sbn_sub(s, at + 1)
	if s:sub(at + 1, at + D.sbn.ident_bytes) ~= IDENT then note("sbn_id_mismatch") end
	local first = at + L.sbn_sub.size
	local size = L.subscription.size
	W.entries = math.min(count, math.floor((#s - first) / size))
	if W.listed then
		local some = {}
		for index = 0, math.min(W.entries, 3) - 1 do
			some[index + 1] = format("0x%04x", (read.subscription(s, first + index * size + 1)))
		end
		W.summary = table.concat(some, ", ") .. (W.entries > 3 and format(" and %d more", W.entries - 3) or "")
	end
	if #s - first < count * size then truncated(L.subscription.name, first, count * size) end
end

-- Read the SBN header and what is its own; return where a space packet starts, if one does.
local function software_bus_network(s)
	local legacy = is_legacy(s)
	local layout = legacy and L.sbn_legacy or L.sbn
	if legacy then note("sbn_legacy_header") end
	if #s >= L.sbn.size and #s % D.limits.bridge_modulus < L.sbn.size and bridge_ports[W.pinfo.dst_port]
		and W.pinfo.port_type ~= TCP then
		note("bridge_drops_length")
	end
	if not take(layout, 0) then return nil end
	local size, kind, processor, spacecraft
	if legacy then
		size, kind, processor = read.sbn_legacy(s, 1)
		spacecraft = 0
	else
		size, kind, processor, spacecraft = read.sbn(s, 1)
	end
	local known, payload = D.sbn.names[kind], #s - layout.size
	W.kind, W.spacecraft, W.processor = known or format("0x%02x", kind), spacecraft, processor
	if size ~= payload then note("sbn_size_mismatch") end
	if not known then note("sbn_unknown_type") end
	if kind == D.sbn.NO_MSG then note("sbn_no_message") end
	identify(spacecraft, processor, known and size == payload)
	if kind == D.sbn.APP then return layout.size end
	if kind == D.sbn.SUB or kind == D.sbn.UNSUB then
		subscriptions(layout.size)
	elseif kind == D.sbn.PROTO and take(L.sbn_proto, layout.size) then
		local version = read.sbn_proto(s, layout.size + 1)
		W.summary = format("protocol version %d", version)
		if version ~= D.sbn.version then note("sbn_version_mismatch") end
	end
	if W.listed then
		local from = legacy and format("from ?:%d", processor) or format("from %d:%d", spacecraft, processor)
		W.summary = (W.summary and W.summary ~= "") and W.summary .. " " .. from or from
	end
	return nil
end

-- Return a header as the steps of a message: its numbers say what it is, of an array the first.
local function steps_of(layout)
	if not layout.steps then
		local leaves, name, codes = {}, nil, {
			double = "d", float = "f", int8 = "i1", int16 = "i2", int32 = "i4", uint8 = "I1", uint16 = "I2", uint32 = "I4",
		}
		for _, slot in ipairs(layout.fields) do
			local code = not slot.mask and slot.name ~= name and codes[slot.kind]
			name = slot.name
			if code then leaves[#leaves + 1] = {
				name = slot.name, offset = slot.start, size = slot.size, code = code, big = ">" .. code, little = "<" .. code,
				form = slot.name .. (code:find("[fd]") and "=%.6g" or "=%d"),
			} end
		end
		layout.steps = {{leaves = leaves, alignment = 1, size = layout.size}}
	end
	return layout.steps
end

-- Read the headers of a link that has the same ones always, or by its length.
local function read_headers(s, link)
	local form, at = link.forms and link.forms[#s], 0
	for _, name in ipairs(form and form.headers or link.headers) do
		if not take(L[name], at) then return nil end
		if link.values then
			if W.listed then W.summary = short_message(steps_of(L[name]), s, at + 1, at + 1, false) end
		elseif not link.packets then
			W.summary = L[name].title or link.title
		end
		at = at + L[name].size
	end
	return link.packets and at or nil
end

-- Links whose headers hang on what they hold read them by themselves.
local HEADER_READERS = {sbn = software_bus_network}
