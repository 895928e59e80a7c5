-- The dissector itself: read a datagram, fill the columns, and add to the tree what is asked for.

local edoras = P.edoras
edoras.prefs.ci_ports = Pref.range("CI ports", "", "UDP ports of Command Ingest", 65535)
edoras.prefs.to_ports = Pref.range("TO ports", "", "UDP ports that Telemetry Output sends to", 65535)
edoras.prefs.sbn_ports = Pref.range("SBN ports", "", "UDP ports of Software Bus Network peers", 65535)
edoras.prefs.extended_header = Pref.bool(
	"Extended header", D.extended_header, "Packets carry cFE's extended (version 2) header"
)
edoras.prefs.short_telemetry_header = Pref.bool(
	"12-byte telemetry header", D.telemetry_header == 12, "Older cFE builds: no spare in the telemetry header"
)

local PROTOCOL = {ci = "CI", to = "TO", sbn = "SBN"}
local registered = {}

local function register_ports()
	local udp = DissectorTable.get("udp.port")
	for port in pairs(registered) do udp:remove(port, edoras) end
	registered = {}
	for link in pairs(ports) do
		ports[link] = port_set(edoras.prefs[link .. "_ports"])
		for _, port in ipairs(D.ports[link]) do ports[link][port] = true end
		for port in pairs(ports[link]) do registered[port] = true end
	end
	for port in pairs(registered) do udp:add(port, edoras) end
	settings.extended = edoras.prefs.extended_header
	settings.telemetry_header = edoras.prefs.short_telemetry_header and 12 or 16
end

function edoras.prefs_changed()
	register_ports()
end

function edoras.init()
	peers, sequences, analysis = {}, {}, {}
	asked.last = math.huge
end

-- Forget what a datagram that the capture cut cannot be blamed for.
local function forgive()
	note("capture_cut")
	local kept = 0
	for index = 1, W.findings do
		local finding = W.found[index]
		if not D.findings[finding].unknowable then
			kept = kept + 1
			W.found[kept] = finding
		end
	end
	W.findings = kept
end

-- What people would say of a packet of which nothing more is known.
local function said_of(msg_id)
	if not msg_id then return W.stop or string.format("%d bytes", #W.s) end
	if W.code then
		local known = (D.commands[msg_id] or {})[W.code]
		return string.format("function code %d", W.code) .. (known and " " .. known.name or "")
	end
	return W.bare and "header only" or D.msg_id_names[msg_id] or ""
end

-- The findings that are more than a note, the gravest first.
local function badges()
	local text = ""
	for rank = 3, 2, -1 do
		for index = 1, W.findings do
			local finding = D.findings[W.found[index]]
			if finding.rank == rank then text = text .. finding.badge .. "  " end
		end
	end
	return text
end

-- A line has no line ends; a format would end at a NUL.
local function printable(text)
	return text:find("%c") and text:gsub("%c", " ") or text
end

local function info()
	local msg_id, head = W.msg_id, W.kind
	local told = printable(W.summary or said_of(msg_id))
	if msg_id then
		local name = W.message and W.route.topic or W.name
		if told == name then told = "" end
		head = string.format(name == "" and "%s 0x%04x" or "%s 0x%04x %s", head, msg_id, name)
	end
	if W.findings > 0 then told = badges() .. told end
	local text = (not head and told) or (told == "" and head) or head .. "  " .. told
	local missing = analysis[W.number]
	if missing then
		text = text .. (type(missing) == "number" and string.format("  [gap of %d]", missing) or "  [" .. missing .. "]")
	end
	return text
end

local function show_envelope(tree, tvb, visible)
	local at, size = W.envelope, W.format.width
	local node = tree:add(edoras, tvb(at, 2 * size), "EDORAS Envelope")
	for index, record in ipairs({F.buffer_length, F.buffer_capacity}) do
		if visible or record.on then
			local range = tvb(at + (index - 1) * size, size)
			node:add(record.field, range, W.format.little and range:le_uint64() or range:uint64())
		end
	end
	return node
end

local function show_message(tree, tvb, visible)
	local at, size, kind = W.body, W.body_end - W.body, W.message
	local record = kind and kind.record or F.body
	local node = tree
	if size > 0 and (visible or record.on) then node = tree:add(record.field, tvb(at, size)) end
	if kind then show_steps(node, kind.steps, tvb, W.s, at + 1, at + 1, W.big, visible) end
end

local function show_findings(node, visible)
	for index = 1, W.findings do
		local finding = D.findings[W.found[index]]
		show_value(node, F.finding, finding.label, visible):add_proto_expert_info(finding.expert)
	end
	local missing = analysis[W.number]
	if missing then
		local kind = type(missing) == "number" and "gap" or missing
		show_value(node, F[kind], kind == "gap" and missing or true, visible):add_proto_expert_info(EXPERT[kind])
	end
end

local function show_facts(node, visible)
	show_value(node, F.link, W.link, visible)
	show_value(node, F.msg_id, W.msg_id, visible)
	if W.msg_id then
		show_value(node, F.name, W.name ~= "" and W.name or nil, visible)
		local known = W.code and (D.commands[W.msg_id] or (D.any_link[W.msg_id] and D.route_commands) or {})[W.code]
		show_value(node, F.command, known and known.name, visible)
	end
	if W.route then
		show_value(node, F.topic, W.route.topic, visible)
		show_value(node, F.type, W.route.type, visible)
	end
	show_value(node, F.mission_time, W.time, visible)
	show_value(node, F.stop, W.stop, visible)
end

-- Add every layer, outermost first.
local function show(tree, tvb, visible)
	local node
	for index = 1, W.layers do
		local layout, at = W.layer[index], W.at[index]
		if layout == L.cdr then node = show_envelope(tree, tvb, visible) end
		local header = show_layout(tree, layout, tvb, at, visible)
		if layout == L.subscriptions then
			for entry = 0, W.entries - 1 do
				show_layout(header, L.subscription, tvb, at + layout.size + entry * L.subscription.size, visible)
			end
		elseif layout == L.cdr then
			if visible or asked.messages then show_message(header, tvb, visible) end
		end
	end
	if not node and W.envelope then node = show_envelope(tree, tvb, visible) end
	if not node then
		node = tree:add(edoras, tvb(0, 0), "EDORAS")
		node:set_generated()
	end
	if W.padding and (visible or F.padding.on) then
		node:add(F.padding.field, tvb(W.padding, #W.s - W.padding))
	end
	show_facts(node, visible)
	return node
end

local function dissect(tvb, pinfo, tree)
	if pinfo.in_error_pkt then return 0 end  -- what an ICMP error quotes was not sent again
	local s = tvb:len() > 0 and tvb:raw() or ""
	local link = link_of(pinfo, byte(s))
	if not link then return 0 end
	begin(s, link, pinfo)
	if link == "ci" and #s > D.limits.ci_buffer then note("over_ci_buffer") end
	if link == "to" and #s > D.limits.bridge_buffer then note("over_bridge_buffer") end
	local start = 0
	if link == "sbn" then start = software_bus_network(s) end
	if start then space_packet(start) end
	if W.msg_id then W.name = name_of(W.msg_id) end
	if tvb:reported_len() > #s then forgive() end

	local columns = pinfo.cols
	columns.protocol = PROTOCOL[link]
	columns.info = info()
	local visible, node = tree.visible, tree
	if visible or look_who_asks(tree, W.number) then node = show(tree, tvb, visible) end
	show_findings(node, visible)
	return #s
end

for name, protocol in pairs(P) do
	protocol.fields = members[name]
	protocol.dissector = dissect
end
edoras.experts = experts
register_ports()
DissectorTable.get("udp.port"):add_for_decode_as(edoras)
