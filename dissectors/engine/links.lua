-- Which link a datagram belongs to: by the mission's endpoints, then by port and content. cpu2's CI port equals
-- TO's destination port (both 1235): a port alone does not tell.

local ports = {ci = {}, to = {}, sbn = {}}
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

-- Return "ci", "to" or "sbn", or nil for none of them.
local function link_of(pinfo, first_byte)
	local destination = pinfo.dst_port
	if ports.sbn[destination] then return "sbn" end
	local ci, to = ports.ci[destination], ports.to[destination]
	local command
	if ci and to then
		command = is_for_cfs(pinfo)
	elseif ci then
		return "ci"
	elseif to then
		return "to"
	else
		local source = pinfo.src_port
		if ports.sbn[source] then return "sbn" end
		if ports.ci[source] or ports.to[source] then return nil end
		-- "Decode As": no port of ours has a say.
	end
	if command == nil then
		command = not first_byte or first_byte % 32 >= 16  -- TO never sends an empty datagram
	end
	return command and "ci" or "to"
end
