-- Which link a datagram belongs to: of the links that claim its port, the one that is surest. cpu2's CI port equals
-- TO's destination port (both 1235): a port alone does not tell.

local ports, stream_ports, link_by_label = {}, {}, {}
for _, link in ipairs(D.links) do
	ports[link.label], link_by_label[link.label] = {}, link
	link.form_ports = {}
	for _, form in pairs(link.forms or {}) do
		if form.port then link.form_ports[form.port] = true end
	end
end
local bridge_ports, cfs = {}, {}
for _, port in ipairs(D.bridge_ports) do bridge_ports[port] = true end
for index, address in ipairs(D.cfs_addresses) do cfs[index] = Address.ip(address) end

local function is_cfs(address)
	for _, known in ipairs(cfs) do
		if address == known then return true end
	end
	return false
end

-- Tell whether a datagram is for cFS, or nil where the addresses do not tell.
local function is_for_cfs(pinfo)
	if #cfs == 0 then return nil end
	local to, from = pinfo.dst, pinfo.src
	if to == from then return nil end
	local for_cfs = is_cfs(to)
	if for_cfs == is_cfs(from) then return nil end
	return for_cfs
end

-- Tell whether a link's first header holds the values that it always holds.
local function holds_constants(link, s)
	local layout = D.layouts[link.headers[1]]
	if #s < layout.size then return false end
	local values = {D.read[link.headers[1]](s, 1)}
	for name, value in pairs(link.constants) do
		if values[layout.place[name]] ~= value then return false end
	end
	return true
end

-- Tell whether the first doubles are likely values, where byte HIGH of each holds the sign and the exponent, LOW the rest.
local function likely_doubles(s, count, high, low)
	for at = 0, 8 * (count - 1), 8 do
		local first, second = byte(s, at + high), byte(s, at + low)
		if first and second then
			local exponent = first % 128 * 16 + (second - second % 16) / 16
			if exponent ~= 0 and (exponent < D.doubles.smallest or exponent > D.doubles.largest) then return false end
		end
	end
	return true
end

local RECOGNISED = {}  -- links whose bytes are asked by a function

-- How sure a link is that a datagram is its own, 0 for not at all: as LinkProtocol.recognise.
local function likeness(link, pinfo, s, length)
	local sure, recognised = link.sure, RECOGNISED[link.label]
	if recognised then return recognised(s, length) and D.sure.by_content or 0 end
	if link.forms then
		local form = link.forms[#s]
		if not form then return 0 end
		if form.port and form.port ~= pinfo.dst_port and link.form_ports[pinfo.dst_port] then return 0 end
		local count = form.doubles
		if count and not likely_doubles(s, count, 8, 7) and not likely_doubles(s, count, 1, 2) then return 0 end
		return D.sure.by_content
	elseif link.constants then
		if not holds_constants(link, s) then return 0 end
		sure = D.sure.by_content
	end
	if link.to_cfs == link.from_cfs then return sure end
	local first = byte(s, link.header_bytes + 1)
	local command = not first or first % 32 >= 16  -- TO never sends an empty datagram
	if command == link.to_cfs then sure = sure + 1 end
	local for_cfs = is_for_cfs(pinfo)
	if for_cfs ~= nil and for_cfs == link.to_cfs then sure = sure + D.sure.by_address end
	return sure
end

local TCP = 2  -- what pinfo.port_type says of TCP
-- Return the link of a message of a TCP stream, or nil for none.
local function stream_link_of(pinfo, s, length)
	for _, port in ipairs({pinfo.dst_port, pinfo.src_port}) do
		for _, link in ipairs(D.links) do
			local claimed = stream_ports[link.label]
			if claimed and claimed[port] then
				local recognised = RECOGNISED[link.label]
				return (not recognised or recognised(s, length)) and link or nil
			end
		end
	end
end

-- Return the link of so many bytes, of which the capture may have cut some; nil for none.
local function link_of(pinfo, s, length)
	if pinfo.port_type == TCP then return stream_link_of(pinfo, s, length) end
	local destination, source = pinfo.dst_port, pinfo.src_port
	local best, found, ours = 0, nil, false
	for _, link in ipairs(D.links) do
		local claimed = ports[link.label]
		if claimed[destination] then
			ours = true
			local sure = likeness(link, pinfo, s, length)
			if sure > 0 and sure >= best then best, found = sure, link end
		elseif claimed[source] then
			ours = true
			if link.sender_port and best == 0 then found = link end
		end
	end
	if ours then return found end
	-- "Decode As": no port of ours has a say.
	for _, link in ipairs(D.links) do
		if link.to_cfs ~= link.from_cfs and #link.headers == 0 then
			local sure = likeness(link, pinfo, s, length)
			if sure >= best then best, found = sure, link end
		end
	end
	return found
end
